"""The emulated MIT-mode motors: Damiao, T-Motor, CubeMars, CyberGear, RobStride."""
