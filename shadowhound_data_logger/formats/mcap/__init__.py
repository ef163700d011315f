"""MCAP files as rosbag2 writes them: the format, its writer, its reader, and the recovery of files that were not closed."""
