"""`clsplat bench`: measurements that users can repeat on their own device."""
