"""Tags in pictures: families, detectors, regions, and files of what was found."""
