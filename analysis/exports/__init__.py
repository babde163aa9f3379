"""What was applied, as files that farms, maps and programs read: one format a file."""
