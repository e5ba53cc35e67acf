"""Modal identification: poles, participation and shapes of many modes from any number of FRFs."""
