"""The gap workflow: where a simulation and measured data disagree, and why."""
