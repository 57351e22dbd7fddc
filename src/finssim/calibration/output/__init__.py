"""What a calibration leaves: vehicle files, ranges, reports, and the commands that write them."""
