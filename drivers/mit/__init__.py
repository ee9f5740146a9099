"""MIT-mode joint motors: Damiao, T-Motor/CubeMars (mini-cheetah), CyberGear, RobStride."""
