"""Scan -> RegisteredScan: KISS-ICP leads, surfaces refine. Only here is kiss_icp met."""
