"""`jaxchain bench`: the speed promises as a table."""
