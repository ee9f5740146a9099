"""Control laws, gain tuner, estimators, trajectories, limits, state machine: pure: no clock, no I/O."""
