"""Importers of lenses: a file for each kind of calibration program. See `finssim.localization.camera_file`."""
