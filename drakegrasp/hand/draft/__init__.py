"""Models of hands as vendors ship them, made into models that the package can use."""
