"""Files of others to a phase history: CPHD and Gotcha."""
