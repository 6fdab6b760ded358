"""``jaxloc lane``."""
