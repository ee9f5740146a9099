"""The emulated moteus controller."""
