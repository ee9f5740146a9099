"""Control laws, tuner, estimators, trajectories, limits, state machine; pure: no clock, no I/O."""
