"""Adapters to other libraries: environments, and the shield; only they import these libraries."""
