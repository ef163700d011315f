"""Diagnoses one machine: checks with a finding, its cause and a remedy. Each has a deadline, and none can stop the others."""
