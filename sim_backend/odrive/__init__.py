"""The emulated ODrive."""
