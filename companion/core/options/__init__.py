"""What a flight may have and most do not; each option stands on the kernel below the controller."""
