"""Tags in pictures: families, detectors, search regions, and detections files."""
