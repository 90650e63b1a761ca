"""Where a loop may be, and whether it is one."""
