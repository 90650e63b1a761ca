"""A ray-cast street drive with truth; everything made here is labelled simulated."""
