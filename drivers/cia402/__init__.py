"""CiA 301 communication and CiA 402 drive profile, cyclic synchronous torque."""
