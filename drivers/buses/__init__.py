"""Bus back-ends, one file each; `drivers.bus` selects by address."""
