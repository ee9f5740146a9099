"""The daemon: configuration, real-time loop, gateway, recordings, reports, client and commands."""
