"""How the folders that kpbench writes are used: the lines of code in their README, which run in the folder itself."""

from __future__ import annotations

DATASET_USAGE = """\
```python
import kpbench

image, keypoints = kpbench.open_dataset(".")[0]
print(image.shape, keypoints["x"], keypoints["y"], keypoints["patch_id"])
```
"""
EXPORT_USAGE = {
    "coco": """\
Run a detector, and score it:

```python
import kpbench

labelled = kpbench.dataset.open_labelled("annotations.json")
found = kpbench.predict(labelled, "template").predictions
print(kpbench.score(labelled, found)["detection_score"])
```

Read the labels with `pip install pycocotools`. Keypoints count from the centre of the top-left pixel, as in kpbench;
boxes count from its corner.

```python
from pycocotools.coco import COCO

coco = COCO("annotations.json")
image = coco.loadImgs(coco.getImgIds()[:1])[0]
for label in coco.loadAnns(coco.getAnnIds(imgIds=[image["id"]])):
    print(image["file_name"], label["patch_id"], label["keypoints"][:2])
```
""",
    "yolo": """\
Train with `pip install ultralytics`. Images of one scene are all in `train` or all in `val`. A mirrored patch may be
another patch, so train without flips.

```sh
yolo pose train data=data.yaml model=yolo11n-pose.yaml epochs=1 fliplr=0 flipud=0
```

Read the labels:

```python
from pathlib import Path

for file in sorted(Path("labels/train").glob("*.txt")):
    for row in file.read_text().splitlines():
        name, x, y, width, height, keypoint_x, keypoint_y, visibility = row.split()
```
""",
    "webdataset": """\
Read the images and labels with `pip install webdataset`:

```python
import glob

import webdataset

for sample in webdataset.WebDataset(sorted(glob.glob("shard-*.tar")), shardshuffle=False).decode("rgb8"):
    image, keypoints = sample["png"], sample["json"]["keypoints"]
    print(sample["__key__"], image.shape, keypoints["x"], keypoints["y"], keypoints["patch_id"])
```
""",
    "parquet": """\
Load the splits with `pip install datasets`:

```python
import os

import datasets

for row in datasets.load_dataset(os.getcwd())["train"]:
    print(row["image"].size, [(point["x"], point["y"], point["patch_id"]) for point in row["keypoints"]])
```

Or read `croissant.json` with `pip install mlcroissant`:

```python
import mlcroissant

described = mlcroissant.Dataset("croissant.json")
for record in described.records("train"):
    print(record["train/image"], record["train/keypoints_x"], record["train/keypoints_y"])
```
""",
}
"""By the format of an export."""
