"""Buses and amplifier families: everything between a torque in Nm and the bytes on a wire."""
