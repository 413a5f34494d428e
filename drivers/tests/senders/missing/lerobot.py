raise ImportError("No module named 'lerobot'", name="lerobot")
