"""The emulated CiA 402 drive: a CANopen device in front of one servo axis."""
