"""Files: what ships and where it is, how it is read, and what it may not say."""
