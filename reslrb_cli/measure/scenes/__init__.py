"""Scenes that measurements bring along."""
