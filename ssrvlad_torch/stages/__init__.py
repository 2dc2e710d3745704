"""The stages of the method, one file each. Only `residuals` and `harmonics` import others."""
