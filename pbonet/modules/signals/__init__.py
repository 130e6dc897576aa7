"""Signal processing: filters, limits, derivatives and integrals of any variable."""
