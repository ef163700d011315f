"""Rows that robots write about their data: the columns of each table, and the files with these rows."""
