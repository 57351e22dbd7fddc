"""A live view in the browser: of the virtual pool and of what was recorded."""
