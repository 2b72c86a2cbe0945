"""Environments: who moves how, what is dangerous, what is seen."""
