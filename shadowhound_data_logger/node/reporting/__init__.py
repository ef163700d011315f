"""The status, diagnostics, the watchdog, the control socket and the bookkeeping objects of the node."""
