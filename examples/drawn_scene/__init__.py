"""The demo: a drawn scene whose texture frequencies are known, and a run that trains and shows the method on it."""
