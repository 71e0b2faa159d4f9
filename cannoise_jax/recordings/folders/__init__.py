"""A folder as a user has it, with whatever names and headers, into one capture set: scan, plan, convert."""
