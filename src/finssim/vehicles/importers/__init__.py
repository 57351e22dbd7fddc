"""Importers of vehicles: one file for each format of another program. See `finssim.vehicles.importers.draft`."""
