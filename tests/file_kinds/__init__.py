"""Files as other programs write them: every rule of reading crossed with every format.

Written by GDAL (pyogrio, rasterio), pyarrow, csv, json, zipfile and, for ISOXML, by the package of
npm where it is at hand; bytes that these would put right are changed afterwards. What is true is
known before the file is written; nothing here knows how the product reads.
"""
