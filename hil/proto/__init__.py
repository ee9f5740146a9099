"""Generated from telemetry.proto; see `make proto`."""
