"""The line map: landmarks merged over keyframes, and its file."""
