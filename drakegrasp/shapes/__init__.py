"""The built-in objects: 64 classes of parametric shapes."""
