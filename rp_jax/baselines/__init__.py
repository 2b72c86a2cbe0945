"""What the method is compared with (appendix G)."""
