"""Missions: the agent logs to a journal, from which a separate process sends to MLflow and the spool."""
