"""The emulator: real protocol state machines in front of a pymunk arm."""
