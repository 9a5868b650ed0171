"""What is made of a registration: its joints, files carried to where the object is, and small files of its state."""
