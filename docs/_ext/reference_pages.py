"""Writes one reference page for each package of torch_denkf that names its public things in ``__all__``.

``python docs/_ext/reference_pages.py`` writes ``docs/reference/names.md``, the list of all of them.
"""

import importlib
import inspect
import pkgutil
import re
from pathlib import Path

import torch_denkf

COMMAND = "python docs/_ext/reference_pages.py"
# Up to the end of a sentence, and up to the end of a clause; formulas and code stay whole.
SENTENCE = re.compile(r"(?:\$[^$]*\$|`[^`]*`|(?!; |\. [A-Z]).)+")
CLAUSE = re.compile(r"(?:\$[^$]*\$|`[^`]*`|(?!; |\. [A-Z]|: | \((?:[A-Z]\S|[a-z]{2})).)+")
OWN_METHODS = {
    "DEnKFTransform": """
        ``DEnKFTransform`` inherits about seventy public methods of torchrl's ``Transform``. Its own methods are:

        =================================  =============================================================================
        method                             what it does, and who calls it
        =================================  =============================================================================
        ``__init__``                       takes the filter; finds out what it reads, carries and writes
        ``forward``                        filters a sequence ``[*B, T]``: called by a replay buffer, or by you
        ``transform_observation_spec``     adds the belief to what the environment says it emits
        ``transform_input_spec``           adds what is carried to the state that the environment takes
        ``_reset``                         writes the initial belief in the rows that reset; called by ``env.reset``
        ``_reset_on_native_autoreset``     the same, in environments that reset themselves
        ``_reset_mask``                    which rows reset, where groups of agents have masks of their own
        ``_step``                          one step of the filter; called by ``env.step``
        ``_emit``                          puts what is kept of a step into what the environment emits
        ``_trial``                         a step on zeros, whose results tell the shapes of the specs
        ``_add_specs``                     the specs of what that trial wrote
        ``_post_step_mdp_hooks``           with ``store_ensemble=False``, leaves the ensemble out of what is stored
        ``_check_batched_worker_compat``   refuses ``store_ensemble=False`` inside a worker process
        =================================  =============================================================================
        """,
}


def packages():
    """The packages with public names."""
    found = {}
    for _, name, is_package in pkgutil.walk_packages(torch_denkf.__path__, "torch_denkf."):
        package = importlib.import_module(name) if is_package and "._" not in name else None
        if getattr(package, "__all__", None):
            found[name.removeprefix("torch_denkf.")] = package
    return found


def directive(package, name):
    """The directive that describes one public name."""
    value = getattr(package, name)
    if inspect.isclass(value) or inspect.isroutine(value):
        return f".. auto{'class' if inspect.isclass(value) else 'function'}:: {package.__name__}.{name}"
    options = f"   :module: {package.__name__}\n   :value: {shown(value)}"
    return f".. py:data:: {name}\n{options}\n\n   {comment(package, name)}"


def shown(value):
    """A constant's value, short."""
    return f"array of {len(value)}" if hasattr(value, "__array__") else repr(value).replace("typing.", "")


def summary(package, name):
    """The first clause of what a public name says of itself, as Markdown."""
    value = getattr(package, name)
    if inspect.isclass(value) or inspect.isroutine(value):
        text = " ".join(inspect.getdoc(value).split("\n\n")[0].split())
    else:
        text = comment(package, name) or f"``{shown(value)}``"
    text = re.sub(r":math:`(.+?)`", r"$\1$", text)
    text = re.sub(r":\w+:`~?(?:[\w.]+\.)?(\w+)`", r"`\1`", text).replace("``", "`")
    clause = CLAUSE.match(text)[0]
    return (clause if len(clause.split()) > 2 else SENTENCE.match(text)[0]).rstrip(".")


def names():
    """The text of the list of all public names, each with the shortest path that imports it."""
    parts = ["# Public names", "", f"`{COMMAND}` writes this list from the docstrings.", ""]
    for title, package in packages().items():
        parts += [f"## {title}", ""]
        for name in package.__all__:
            path = "torch_denkf" if name in torch_denkf.__all__ else package.__name__
            parts.append(f"- `{path}.{name}`: {summary(package, name)}")
        parts.append("")
    return "\n".join(parts)


def comment(package, name):
    """Returns what stands behind a constant in the source."""
    for file in Path(package.__file__).parent.rglob("*.py"):
        found = re.search(rf"^{name} = .*?  # (.+)$", file.read_text(), re.MULTILINE)
        if found:
            return found[1]
    return ""


def page(name, package):
    """The reStructuredText of a package's page."""
    title = f"torch_denkf.{name}"
    names = list(package.__all__)
    parts = [
        title,
        "=" * len(title),
        "",
        f".. automodule:: {title}\n   :no-members:\n",
        f".. currentmodule:: {title}\n",
        ".. autosummary::\n   :nosignatures:\n",
        *(f"   {public}" for public in names),
        "",
    ]
    for public in names:
        parts += ["", public, "-" * len(public), "", directive(package, public), ""]
        if public in OWN_METHODS:
            parts += [inspect.cleandoc(OWN_METHODS[public]), ""]
    return "\n".join(parts)


def write(app):
    """Writes the pages that changed."""
    for name, package in packages().items():
        path, text = Path(app.srcdir) / "reference" / f"{name}.rst", page(name, package)
        if not path.exists() or path.read_text() != text:
            path.write_text(text)


def skip(app, what, name, obj, would_skip, options):
    """Leaves out the fields of named tuples, which their class describes, and the losses' alias of their keys."""
    return True if type(obj).__name__ == "_tuplegetter" or name == "default_keys" else None


def describe_constant(app, what, name, obj, options, lines):
    """Shows the source's comment instead of what the constant's type says about itself."""
    if what == "data":
        package, _, constant = name.rpartition(".")
        lines[:] = [comment(importlib.import_module(package), constant)]


def own_signature(app, what, name, obj, options, signature, annotation):
    """Shows the arguments of ``__init__`` where a metaclass hides them."""
    if what == "class" and signature == "(*args, **kwargs)":
        parameters = list(inspect.signature(inspect.unwrap(obj.__init__)).parameters.values())[1:]
        bare = [parameter.replace(annotation=parameter.empty) for parameter in parameters]
        return str(inspect.Signature(bare)), annotation
    return None


def setup(app):
    """Registers the extension."""
    app.connect("builder-inited", write)
    app.connect("autodoc-skip-member", skip)
    app.connect("autodoc-process-docstring", describe_constant)
    app.connect("autodoc-process-signature", own_signature)
    return {"parallel_read_safe": True}


if __name__ == "__main__":
    (Path(__file__).parents[1] / "reference" / "names.md").write_text(names())
