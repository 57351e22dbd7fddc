"""Kinds of actuators, one file each: keys in a vehicle file, wrench or shift of mass, and units."""
