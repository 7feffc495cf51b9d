"""Models that TextOCVP is compared with and that are no TextOCVP themselves."""
