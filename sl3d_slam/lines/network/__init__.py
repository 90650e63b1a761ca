"""The line network after SuperLine3D: points in, line probability and descriptor per point out."""
