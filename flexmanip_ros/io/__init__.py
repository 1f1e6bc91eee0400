"""Bags, tables, parameter files and reports."""
