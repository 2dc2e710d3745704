"""The stages of the method, one file each, on `bitplanes`; what is made of several, and shows them."""
