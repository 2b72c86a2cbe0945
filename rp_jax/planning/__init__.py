"""Planning: learning to earn reward inside the admissible set (Algorithms 3 and 4)."""
