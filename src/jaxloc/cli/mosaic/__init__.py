"""``jaxloc mosaic``."""
