"""Finite CMDPs, solved exactly: the oracle that the approximate part is judged by."""
