"""What touches disk and screen: run folders, tables, figures."""
