"""One file a benchmark; peers come from the ``bench`` extra."""
