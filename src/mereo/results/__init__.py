"""What is made of a registration: files carried to where the object is, and small files of its state."""
