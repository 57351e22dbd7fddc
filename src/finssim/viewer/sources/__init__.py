"""Where the pictures of a view come from: records, runs of the engine, the virtual pool and the simulator."""
