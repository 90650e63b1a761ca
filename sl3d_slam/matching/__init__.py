"""Two line sets in, matches and a relative pose out; no first guess."""
