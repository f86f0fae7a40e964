"""The paper's figures and tables from measured data: no measuring happens here."""
