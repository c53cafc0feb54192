"""Hard real time: slopes in, commands out."""
