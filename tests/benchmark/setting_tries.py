"""Tries of robustness.py: configurations, outputs, comparisons and names."""

from __future__ import annotations

import os

import torch
from tries import ROOT

from phydict.cli.infer import main as infer
from phydict.runtime.files import machine


def configurations():
    """YAML configurations."""
    no = False
    for name, content, good, word in (
            ("model null", {"model": None}, None, ""), ("data null", {"data": None}, None, ""), ("trainer null",
            {"trainer": None}, None, ""),
            ("a number as key", {3: 4}, no, "3"), ("null as key", {None: 4}, no, ""), ("true as key", {True: 4}, no,
            ""),
            ("a number as key of model", {"model": {3: 4}}, no, "3"), ("null as key of data", {"data": {None: 1}}, no,
            ""),
            ("a nested number as key", {"model": {"method": {"class_path": "phydict.baselines.SIRT",
            "init_args": {7: 1}}}}, no, "7"),
            ("dotted keys", {"model.seed": 3}, None, ""), ("an empty key", {"": 3}, no, ""), ("a key of dots",
            {"...": 3}, no, ""),
            ("a key with dashes", {"--model.seed": 3}, no, ""), ("a key with a space", {"model seed": 3}, no, ""),
            ("seed a list", {"model": {"seed": [1]}}, no, "seed"), ("seed true", {"model": {"seed": True}}, None,
            "seed"),
            ("seed a text", {"model": {"seed": "one"}}, no, "seed"), ("seed null", {"model": {"seed": None}}, no,
            "seed"),
            ("seed 1e3", {"model": {"seed": 1e3}}, None, "seed"), ("name null", {"model": {"name": None}}, None, ""),
            ("name a list", {"model": {"name": ["a"]}}, no, "name"), ("name a number", {"model": {"name": 3}}, None,
            "name"),
            ("name of dots", {"model": {"name": "..."}}, None, ""), ("name of a space", {"model": {"name": " "}}, None,
            ""),
            ("name with a null byte", {"model": {"name": "a\0b"}}, no, "name"), ("name with a line break",
            {"model": {"name": "a\nb"}}, None, ""),
            ("name of 300 letters", {"model": {"name": "a" * 300}}, no, ""), ("name with markup",
            {"model": {"name": "[/b]"}}, None, ""),
            ("name of a record", {"model": {"name": ".hidden"}}, None, ""), ("name with dollars",
            {"model": {"name": "$a$b$"}}, None, ""),
            ("name dry_run", {"model": {"name": "dry_run"}}, None, ""),
            ("out a list", {"model": {"out": [1]}}, None, "out"),
            ("method null", {"model": {"method": None}}, no, "method"), ("method a number", {"model": {"method": 3}},
            no, "method"),
            ("method without class_path", {"model": {"method": {"init_args": {"iterations": 2}}}}, None, ""),
            ("class_path a list", {"model": {"method": {"class_path": ["a"]}}}, no, "method"),
            ("class_path of dots", {"model": {"method": {"class_path": "a..b"}}}, no, "method"),
            ("class_path of a module", {"model": {"method": {"class_path": "phydict.baselines"}}}, no, "method"),
            ("class_path with code", {"model": {"method": {"class_path": "__import__('os').system('touch pwned')"}}},
            no, "method"),
            ("class_path eval", {"model": {"method": {"class_path": "builtins.eval", "init_args": {"source": "1"}}}},
            no, "method"),
            ("init_args a list", {"model": {"method": {"class_path": "phydict.baselines.SIRT", "init_args": [1]}}}, no,
            ""),
            ("init_args null", {"model": {"method": {"class_path": "phydict.baselines.SIRT", "init_args": None}}},
            None, ""),
            ("init_args twice nested", {"model": {"method": {"class_path": "phydict.baselines.SIRT",
            "init_args": {"init_args": {"iterations": 1}}}}}, no, ""),
            ("a method in the method", {"model": {"method": {"class_path": "phydict.posterior.SplitGibbs",
            "init_args": {"likelihood": {"class_path": "phydict.baselines.SIRT"}}}}}, no, "likelihood"),
            ("prior a mapping", {"model": {"prior": {"path": 3}}}, None, ""), ("prior a list",
            {"model": {"prior": ["a"]}}, None, ""),
            ("views a text", {"data": {"orbit": {"views": "8"}}}, None, ""),
            ("detector a text", {"data": {"orbit": {"detector": "24,24"}}}, no, "detector"),
            ("detector nested", {"data": {"orbit": {"detector": [[24], [24]]}}}, no, "detector"), ("pixel null",
            {"data": {"orbit": {"pixel": None}}}, None, ""),
            ("simulator a word", {"data": {"simulator": "ideal"}}, no, "simulator"), ("simulator null",
            {"data": {"simulator": None}}, None, ""),
            ("trainer.devices a mapping", {"trainer": {"devices": {"n": 1}}}, no, "devices"),
            ("trainer.callbacks of open", {"trainer": {"callbacks": [{"class_path": "builtins.open",
            "init_args": {"file": "pwned", "mode": "w"}}]}}, no, "callbacks"),
            ("trainer.strategy of words", {"trainer": {"strategy": "fast"}}, no, "strategy"),
            ("trainer.plugins of a shell", {"trainer": {"plugins": [{"class_path": "os.system"}]}}, no, "plugins"),
            ("subcommand", {"subcommand": "test"}, None, ""), ("predict nested", {"predict": {"model": {"seed": 1}}},
            no, ""),
            ("config in config", {"config": "other.yaml"}, None, ""), ("seed_everything", {"seed_everything": "x"}, no,
            "seed_everything"),
            ("help as key", {"help": True}, no, ""), ("print_config as key", {"print_config": True}, no, ""),
            ("dry_run as text", {"dry_run": "often"}, no, "dry_run"), ("return_predictions",
            {"return_predictions": True}, no, ""),
            ("class as key", {"__class__": "x"}, no, ""), ("path as key", {"__path__": "x"}, None, "")):
        yield name, good, word, lambda p, content=content: p.settings(content)
    for name, content, good, word in (
            ("empty", "", no, ""), ("a list", "- a\n- b\n", no, "mine.yaml"), ("a text", "hello", no, "mine.yaml"),
            ("rubbish", "{]", no, "mine.yaml"),
            ("binary", bytes(range(256)), no, "mine.yaml"), ("a python tag", "model: !!python/name:os.system", no,
            "mine.yaml"),
            ("an include", "model: !include /etc/passwd", no, "mine.yaml"), ("environment", "model: {name: ${HOME}}",
            None, ""),
            ("3 anchors", "a: &a {seed: 3}\nmodel: *a\n", None, ""), ("a date", "model: {name: 2020-01-01}", None, ""),
            ("a float with 1000 digits", "model: {cube: {side: 1." + "0" * 1000 + "}}", no, "side"), ("a key twice",
            "model: {seed: 1, seed: 2}", no, "seed"),
            ("40 levels", "model: " + "{a: " * 40 + "1" + "}" * 40, no, "mine.yaml"), ("a colon in text",
            "model: {name: 'a: b'}", None, ""),
            ("emoji", "model: {name: 🫁}", True, ""), ("a lone surrogate", 'model: {name: "\\ud800"}', None, ""),
            ("an escape beyond Unicode", 'model: {name: "\\U00110000"}', no, "mine.yaml"), ("omegaconf",
            "model: {seed: ${oc.env:HOME}}", no, "")):
        yield f"text {name}", good, word, lambda p, content=content: p.settings(content)
    yield "a name with a colon", None, "", lambda p: (f := p.write("a:b.yaml", "model: {seed: 1}"), p.predict(p.case(),
        "-c", f))
    yield "a name with anchors and a colon", no, "", lambda p: (f := p.write("a:b.yaml",
        "a: &a [1,1,1,1,1,1,1,1,1,1]\n" + "".join(
        f"{chr(98 + i)}: &{chr(98 + i)} [{','.join(['*' + chr(97 + i)] * 10)}]\n" for i in range(8))),
        p.predict(p.case(), "-c", f))
    yield "a name with a space", None, "", lambda p: (f := p.write("a b.yaml", "model: {seed: 1}"), p.predict(p.case(),
        "-c", f))
    yield "a pipe", no, "", lambda p: (f := p.given / "pipe.yaml", os.mkfifo(f), infer(["predict", "-c", str(f),
        "--data.xrays=x"]))


def outputs():
    """Where results go."""
    no = False
    yield "in the X-rays", no, "model.out", lambda p: (c := p.case(), p.predict(c, out=c / "out"))
    yield "around the X-rays", no, "", lambda p: (c := p.case("sirt/case"), p.predict(c, out=p.given))
    yield "through a link", no, "model.out", lambda p: (c := p.case(), (p.root / "l").symlink_to(c), p.predict(c,
        out=p.root / "l" / "out"))
    yield "X-rays through a link", no, "model.out", lambda p: (c := p.case(), (p.root / "l").symlink_to(c),
        p.predict(p.root / "l", out=c))
    yield "through ..", no, "model.out", lambda p: (c := p.case(), p.predict(c, out=p.given / "x" / ".." / "case"))
    yield "the pages in the X-rays", no, "model.out", lambda p: (c := p.case("dry_run"), p.predict(c, "--dry_run",
        out=p.given))
    yield "a file", no, "model.out", lambda p: p.predict(p.case(), out=p.write("file", "x"))
    yield "below a file", no, "model.out", lambda p: p.predict(p.case(), out=p.write("file", "x") / "y")
    yield "a dangling link", None, "", lambda p: ((p.root / "out").symlink_to("nowhere/there"), p.predict(p.case()))
    yield "a link to itself", no, "model.out", lambda p: ((p.root / "out").symlink_to("out"), p.predict(p.case()))
    yield "/dev/null", no, "model.out", lambda p: p.predict(p.case(), out="/dev/null")
    yield "/proc", no, "model.out", lambda p: p.predict(p.case(), out="/proc/out")
    yield "/sys", no, "model.out", lambda p: p.predict(p.case(), out="/sys/out")
    yield "an empty name", None, "", lambda p: p.predict(p.case(), "--model.out=")
    yield "300 letters", no, "model.out", lambda p: p.predict(p.case(), out="x" * 300)
    yield "5000 letters deep", no, "model.out", lambda p: p.predict(p.case(), out="/".join(["x" * 100] * 50))
    yield "spaces, quotes and line breaks", True, "", lambda p: p.predict(p.case(),
        out=p.root / "a b'c\"d\n$(touch pwned)`e`;f")
    yield "emoji", True, "", lambda p: p.predict(p.case(), out=p.root / "🫁é")
    yield "no UTF-8", True, "", lambda p: p.predict(p.case(), out=os.fsdecode(os.fsencode(p.root) + b"/\xe9"))
    yield "markup", True, "", lambda p: p.predict(p.case(), out=p.root / "[" / "b]")
    yield "a case's place is a file", no, "case", lambda p: (p.write(p.out / "sirt/case", "mine"), p.predict(p.case()))
    yield "a case's place is an empty folder", no, "case", lambda p: ((p.out / "sirt/case").mkdir(parents=True),
        p.predict(p.case()))
    yield "a case's place is a dangling link", no, "case", lambda p: ((p.out / "sirt").mkdir(parents=True),
        (p.out / "sirt/case").symlink_to("x"), p.predict(p.case()))
    yield "a case's place, overwritten", no, "case", lambda p: (p.write(p.out / "sirt/case/mine.txt", "mine"),
        p.predict(p.case(), "--model.overwrite=true"))

    def twice(*more, between=lambda p: None, good_first=()):
        def work(p):
            c = p.case()
            p.predict(c, *good_first)
            between(p)
            p.predict(c, *more)
        return work

    yield "twice", True, "", twice()
    yield "twice, overwritten", True, "", twice("--model.overwrite=true")
    yield "twice with another seed", no, "overwrite", twice("--model.seed=3")
    yield "twice, one's own file among them", no, "mine.txt", twice(
        "--model.overwrite=true", between=lambda p: p.write(p.out / "sirt/case/mine.txt", "mine"))
    yield "twice, a folder among them", no, "", twice(
        "--model.overwrite=true", between=lambda p: p.write(p.out / "sirt/case/volume/mine.txt", "mine"))
    yield "twice, the record lists a file of one's own", None, "", twice("--model.overwrite=true",
        between=lambda p: p.write(
        p.out / "sirt/case/reconstruction.json", (p.out / "sirt/case/reconstruction.json").read_text().replace(
        '"files": [', '"files": ["../../..", "mine.txt",')))
    yield "twice, the volume gone", None, "", twice(between=lambda p: (p.out / "sirt/case/volume.nii.gz").unlink())
    yield "leftovers of a killed run", True, "", lambda p: ((
        p.out / f"sirt/.case.{machine()}.999999.partial").mkdir(parents=True), p.predict(p.case()))
    yield "set aside by a killed run", True, "", twice(between=lambda p: (p.out / "sirt/case").rename(
        p.out / "sirt/.case.set-aside-by-phydict"))
    yield "X-rays below a folder called as the output", None, "", lambda p: p.predict(p.case("runs/sirt"),
        out=p.root / "runs")
    yield "the demo's folder as X-rays and output", no, "", lambda p: p.predict("data/example/xrays",
        out=ROOT / "data/example/xrays")
    yield "a stranger's page", None, "", lambda p: (p.write(p.out / "dry_run/case.png", "mine"), p.predict(p.case(),
        "--dry_run"), (_ for _ in ()).throw(
        AssertionError("the file was replaced")) if (p.out / "dry_run/case.png").read_bytes() != b"mine" else None)
    yield "ablate into the CTs", no, "", lambda p: (c := p.ct().parent, p.ablate({"phantoms": ..., "cts": str(c),
        "out": str(c)}))
    yield "ablate into a folder in the CTs", no, "", lambda p: (c := p.ct().parent, p.ablate({"phantoms": ...,
        "cts": str(c), "out": str(c / "x")}))
    yield "fit into the CTs", no, "", lambda p: (c := p.ct().parent, p.fit(f"--data.cts={c}", "--data.phantoms=0",
        f"--out={c}"))
    yield "export onto a link", None, "", lambda p: p.train("export", "--checkpoint=x.ckpt",
        f"--out={p.out}/x.safetensors")


def ablations():
    """Specifications of ablate."""
    no = False
    for name, content, good, word in (
            ("as it should be", {}, True, ""), ("no cases", {"phantoms": ...}, no, "cts"), ("phantoms a text",
            {"phantoms": "1"}, no, "phantoms"),
            ("phantoms -1", {"phantoms": -1}, no, "phantoms"), ("phantoms true", {"phantoms": True}, no, "phantoms"),
            ("out a number", {"out": 3}, no, "out"),
            ("out null", {"out": None}, no, "out"), ("axes a list", {"axes": [1]}, no, "axes"), ("axes null",
            {"axes": None}, no, "method"),
            ("an axis empty", {"axes": {"method": []}}, no, "method"), ("an axis a number",
            {"axes": {"method": ["sirt"], "views": 3}}, no, "views"),
            ("an axis of mappings", {"axes": {"method": ["sirt"], "views": [{"a": 1}]}}, no, "views"), ("views nan",
            {"axes": {"method": ["sirt"], "views": [float("nan")]}}, no, "views"),
            ("views 0", {"axes": {"method": ["sirt"], "views": [0]}}, no, "view"), ("views 10^9",
            {"axes": {"method": ["sirt"], "views": [10**9]}}, no, "views"),
            ("detector 0", {"axes": {"method": ["sirt"], "detector": [0]}}, no, "detector"), ("pixel -1",
            {"axes": {"method": ["sirt"], "pixel": [-1.0]}}, no, "pixel"),
            ("seed -1", {"axes": {"method": ["sirt"], "seed": [-1]}}, no, "seed"), ("seed a text",
            {"axes": {"method": ["sirt"], "seed": ["a"]}}, no, "seed"),
            ("a method that is not there", {"axes": {"method": ["magic"]}}, no, "magic"), ("a method that is a list",
            {"axes": {"method": [["sirt"]]}}, no, "method"),
            ("a field that is not there", {"axes": {"method": ["sirt"], "method.speed": [1]}}, no, "speed"),
            ("method.", {"base": {"method.": 1}}, no, "method."),
            ("a field of a field", {"axes": {"method": ["sirt"], "method.iterations.x": [1]}}, no, "iterations"),
            ("dots", {"base": {"..": 1}}, no, ".."),
            ("a number as setting", {"base": {3: 1}}, no, "3"), ("null as setting", {"base": {None: 1}}, no, "None"),
            ("iterations 0", {"axes": {"method": ["sirt"], "method.iterations": [0]}}, no, "iteration"),
            ("iterations a text", {"axes": {"method": ["sirt"], "method.iterations": ["many"]}}, no, "iterations"),
            ("methods a list", {"methods": ["sirt"]}, no, "methods"), ("a method of nothing",
            {"methods": {"mine": {"of": "magic"}}}, no, "magic"),
            ("a method named by a number", {"methods": {3: {"of": "sirt"}}}, None, ""), ("a method of a list",
            {"methods": {"mine": {"of": ["sirt"]}}}, no, "mine"),
            ("a method with markup and bars", {"methods": {"[/b]|$a$b": {"of": "sirt"}},
            "axes": {"method": ["[/b]|$a$b"]}}, True, ""),
            ("a method with one dollar and a backslash", {"methods": {"a$b\\frac$": {"of": "sirt"}},
            "axes": {"method": ["a$b\\frac$", "sirt"]}}, True, ""),
            ("products and axes", {"products": [{}]}, no, "products"), ("products empty", {"axes": ...,
            "products": []}, no, "products"),
            ("products of numbers", {"axes": ..., "products": [3]}, no, "product"), ("10^6 combinations",
            {"axes": {"method": ["sirt"], "seed": list(range(1000)), "views": list(range(1, 1000))}}, no,
            "combinations"),
            ("9000 combinations", {"axes": {"method": ["sirt"], "seed": list(range(90)), "views": list(range(1,
            101))}}, None, ""),
            ("30 products of 9000", {"axes": ..., "products": [{"axes": {"method": ["sirt"], "seed": list(range(90)),
            "views": list(range(1, 101))}}] * 30}, None, ""),
            ("voxels 0", {"base": {"voxels": 0}}, no, "voxels"), ("voxels 10^5", {"base": {"voxels": 10**5}}, no,
            "GiB"), ("side nan", {"base": {"voxels": 16, "side": float("nan")}}, no, "side"),
            ("simulator magic", {"base": {"simulator": "magic"}}, no, "magic"), ("simulator.noise below 0",
            {"base": {"voxels": 16, "simulator.noise": -1.0}}, no, "noise"),
            ("a prior that is not there", {"axes": {"method": ["prior_only"], "prior": ["nowhere.safetensors"]},
            "base": {"views": 2}}, no, "nowhere"),
            ("guidance nan", {"axes": {"method": ["prior_only"], "guidance": [float("nan")]}, "base": {"views": 2}},
            no, "guidance"),
            ("delta 2", {"axes": {"method": ["phydict_paper"], "delta": [2.0]}, "base": {"views": 2}}, None, ""),
            ("a report of words", {"base": {"report": "maybe"}}, no, "report"), ("an unknown key", {"colour": 1}, no,
            "colour"), ("only of phantoms", {"only": "x.txt"}, None, "")):
        yield name, good, word, lambda p, content=content: p.ablate(content)
    for name, content in (("empty", ""), ("a list", "[]"), ("a number", "3"), ("null", "null"), ("rubbish", "{"),
        ("binary", bytes(range(256)))):
        yield f"text {name}", no, "spec.yaml", lambda p, content=content: p.ablate(content)
    yield "a device that is not there", no, "device", lambda p: p.ablate({}, "--device=warp")
    yield "cuda where there is none", None if torch.cuda.is_available() else no, "cuda", lambda p: p.ablate({},
        "--device=cuda")
    yield "an option that is not there", no, "colour", lambda p: p.ablate({}, "--colour=red")

    def edited(change, good, word):
        def work(p):
            p.ablate({})
            file = p.out / "results.csv"
            file.write_bytes(change(file.read_bytes()))
            p.ablate({})
        return good, word, work

    yield "a table of another's", *edited(lambda b: b"a,b\n1,2\n", no, "results.csv")
    yield "a table cut", *edited(lambda b: b[:-20], None, "results.csv")
    yield "a table with a line more", *edited(lambda b: b + b"x\n", no, "results.csv")
    yield "a table with a huge field", *edited(lambda b: b + b"x" * 200000 + b"\n", no, "results.csv")
    yield "a table of binary", *edited(lambda b: bytes(range(256)), no, "results.csv")
    yield "a table empty", *edited(lambda b: b"", None, "results.csv")
    yield "a table with null bytes", *edited(lambda b: b + b"\0" * 500, None, "results.csv")
    yield "a table in UTF-16", *edited(lambda b: b.decode().encode("utf-16"), no, "results.csv")
    yield "a table with words for numbers", *edited(lambda b: b.replace(b",ok,", b",ok,", 1).replace(b"cpu", b"cpu"),
        True, "")

    def psnr(b, value):
        import csv
        import io
        rows = list(csv.reader(io.StringIO(b.decode())))
        rows[1][rows[0].index("psnr")] = value
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows(rows)
        return text.getvalue().encode()

    for value in ("good", "nan", "inf", "", "1e999"):
        yield f"a table with a PSNR of {value or 'nothing'}", *edited(lambda b, value=value: psnr(b, value), None,
            "results.csv")
    yield "a stranger's picture in the folder", no, "", lambda p: (p.write(p.out / "cat.png", "mine"), p.ablate({}))
    yield "a stranger's table in the folder", no, "", lambda p: (p.write(p.out / "tables.md", "mine"), p.ablate({}))


def names():
    """Names of cases."""
    for name in ("a b", "a$x$b", "$\\frac$", "$", "a_{", "[/b]", "[red]", "a|b", "a,b", "a;b", 'a"b', "a'b", "a\nb",
        "a\tb", "a\rb", "é", "🫁", "-rf", "--help", "%s", "{0}", "{x",
                 "a" * 200, "a" * 255, "con", "a.", " ", "\u202eabc", "\u200b", "..a", "a\\", "=1+1", "~", "*", "?",
                 "<b>", "&amp;", "\x1b[31mred", "sirt", "volume.nii.gz", "reconstruction.json"):
        yield f"X-rays {name[:12]!r}", True if len(name) < 200 else None, "", lambda p, name=name: p.predict(p.case(
            name))
    yield "X-rays no UTF-8", True, "", lambda p: p.predict(p.case(os.fsdecode(b"caf\xe9")))
    for name in ("a$x$b", "$\\frac$", "[/b]", "a|b", "a,b", 'a"b', "a\nb", "🫁", "a" * 200, "=1+1", "\u202eabc",
        os.fsdecode(b"caf\xe9")):
        yield f"CT {name[:12]!r}", True if len(name) < 200 else None, "", lambda p, name=name: p.test(p.ct(
            f"{name}.nii.gz"))
        yield f"CT {name[:12]!r} in an ablation", True if len(name) < 200 else None, "", lambda p, name=name: p.ablate(
            {"phantoms": ..., "cts": str(p.ct(f"{name}.nii.gz").parent)})
    yield "page of '$x$y'", True, "", lambda p: p.dry(p.case("$\\x$y"))
    yield "page of no UTF-8", True, "", lambda p: p.dry(p.case(os.fsdecode(b"caf\xe9")))
    yield "two cases that differ in capitals", True, "", lambda p: (p.case("A"), p.case("a"), p.predict(p.given))
