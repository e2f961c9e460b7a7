"""The pictures of `drakegrasp figures`, and what the figures of the docs share with them."""
