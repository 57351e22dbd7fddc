"""A pose from the tags of one picture, by several methods."""
