raise ImportError("No module named 'rtde_receive'", name="rtde_receive")
