"""The arm, its signals, modes and payload on one page of a browser: live, or from a recording."""
