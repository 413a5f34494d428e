raise ImportError("No module named 'rclpy'", name="rclpy")
