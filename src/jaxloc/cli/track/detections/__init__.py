"""``jaxloc track`` of detections."""
