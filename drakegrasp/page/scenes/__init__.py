"""Scenes on the page: views by cameras that know no grasp, and the hands that closed in them."""
