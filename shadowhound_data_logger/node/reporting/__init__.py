"""The status, diagnostics, the watchdog and the control socket of the node."""
