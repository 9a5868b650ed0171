"""Answers over HTTP: many clients, frames of several objects, one machine."""
