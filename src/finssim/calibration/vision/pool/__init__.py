"""Camera pose and water plane, from surveyed points."""
