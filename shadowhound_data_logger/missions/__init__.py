"""Missions: what the agent logs goes to a journal, and from there to MLflow and the spool by a process of its own."""
