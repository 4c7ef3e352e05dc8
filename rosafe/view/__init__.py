"""What a person gets to see: where a source is, pictures and tables. No ROS in here."""
