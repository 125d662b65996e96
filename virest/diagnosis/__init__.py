"""Is the model right? What a capture measures against what the profile predicts, and the causes of the difference."""
