"""Scenes: several objects of several classes, detected, classified and tracked as frames come."""
