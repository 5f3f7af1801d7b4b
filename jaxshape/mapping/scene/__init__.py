"""Scenes: several objects of several classes, found, told apart and kept apart as frames come."""
