"""ODrive amplifiers over CANSimple."""
