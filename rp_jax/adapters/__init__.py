"""Environments and shield for other libraries; each module is the only importer of its library."""
