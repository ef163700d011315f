"""Missions: the agent logs to a journal, from which a separate process sends to MLflow and the spool.

What an agent logs is in the journal when the call returns, and exactly once in MLflow and in the store after that.
"""
