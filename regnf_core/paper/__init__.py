"""The preset `paper`: the method of Reg-NF (ICRA 2024) as published."""
