"""What a mesh file declares: each format read line by line, and nothing passed over in silence."""
