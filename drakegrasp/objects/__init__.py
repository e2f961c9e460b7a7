"""Objects to grasp: mesh sources, their solid models, what is wrong with them."""
