"""One splat whose Gaussians are spread over several processes, each with a device of its own."""
