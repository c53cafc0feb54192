"""What the halves of srtomo agree on: instrument, layout, reconstructor, wire and bags. Imports no ROS."""
