"""Why it does not work, and what to do: checks of one machine, each with a deadline, none of which can stop the others."""
