"""The built-in objects, made of parametric shapes."""
