"""Where in a saved map: places that a scan's lines vote for, each verified, one answer or a no."""
