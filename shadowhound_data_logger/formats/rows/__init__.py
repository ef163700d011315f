"""The catalog as a robot writes it: the columns, the row of each object, and Parquet parts of what was delivered."""
