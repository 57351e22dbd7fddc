"""Importers of lenses, one file per family of calibration programs. See `finssim.localization.camera_file`."""
