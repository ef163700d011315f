"""A simulated Go2 and an embedded Tower, for the demo and the tests."""
