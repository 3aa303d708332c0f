"""Programs that run in a process of their own; each prints its result as JSON in the last line."""
