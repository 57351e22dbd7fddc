"""A live view in the browser: of the virtual pool, of the simulator, and of what was recorded."""
