"""The stages of the method, one file each; what is made of several of them; what shows them."""
