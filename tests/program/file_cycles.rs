//! Checks that the source files of each crate do not import each other in cycles.
//!
//! The graph is read from the source: `use` items and paths such as `crate::join::Join`, followed
//! through re-exports to the file that defines the name. A module may import from its parents, and
//! a parent may re-export its children, so imports of a module's own submodules do not count. Test
//! code does not count either.
#![expect(clippy::unwrap_used, reason = "a test that cannot continue may panic")]

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use syn::visit::Visit;
use syn::{Attribute, Item, UseTree};

/// Source folders of the crates, relative to the workspace.
const ROOTS: [&str; 15] = [
    "kinematics/src",
    "keyframe/src",
    "calibration/src",
    "trainer/model-files/src",
    "calibration/procedures/src",
    "drivers/src",
    "sim/src",
    "capture/src",
    "trainer/gpu/src",
    "trainer/src",
    "viz/src",
    "session/src",
    "session/report/src",
    "targets/src",
    "bench/src",
    "src",
];

/// Path of a module within its crate; empty for the crate root.
type Module = Vec<String>;
/// The modules that each module imports from.
type Graph = BTreeMap<Module, BTreeSet<Module>>;

/// Imports and re-exports of one file.
#[derive(Default)]
struct File {
    /// Paths as written: relative ones start with `self`, `super`, or the name of a submodule.
    paths: Vec<Module>,
    /// Re-exported names and the paths that they refer to.
    exports: BTreeMap<String, Module>,
    /// Submodules in separate files that are compiled only for tests.
    test_modules: Vec<String>,
}

fn is_for_tests(attributes: &[Attribute]) -> bool {
    attributes.iter().any(|attribute| {
        let syn::Meta::List(list) = &attribute.meta else {
            return false;
        };
        list.path.is_ident("cfg")
            && list
                .tokens
                .to_string()
                .split(|c: char| !c.is_alphanumeric())
                .any(|word| word == "test")
    })
}

fn attributes(item: &Item) -> &[Attribute] {
    match item {
        Item::Const(item) => &item.attrs,
        Item::Enum(item) => &item.attrs,
        Item::Fn(item) => &item.attrs,
        Item::Impl(item) => &item.attrs,
        Item::Macro(item) => &item.attrs,
        Item::Mod(item) => &item.attrs,
        Item::Static(item) => &item.attrs,
        Item::Struct(item) => &item.attrs,
        Item::Trait(item) => &item.attrs,
        Item::Type(item) => &item.attrs,
        Item::Use(item) => &item.attrs,
        _ => &[],
    }
}

impl<'ast> Visit<'ast> for File {
    fn visit_item(&mut self, item: &'ast Item) {
        if is_for_tests(attributes(item)) {
            if let Item::Mod(module) = item
                && module.content.is_none()
            {
                self.test_modules.push(module.ident.to_string());
            }
            return;
        }
        syn::visit::visit_item(self, item);
    }

    fn visit_impl_item_fn(&mut self, function: &'ast syn::ImplItemFn) {
        if !is_for_tests(&function.attrs) {
            syn::visit::visit_impl_item_fn(self, function);
        }
    }

    fn visit_item_use(&mut self, item: &'ast syn::ItemUse) {
        let is_public = !matches!(item.vis, syn::Visibility::Inherited);
        let mut found = Vec::new();
        flatten(&item.tree, &mut Vec::new(), &mut found);
        for (name, path) in found {
            if is_public {
                self.exports.insert(name, path.clone());
            }
            self.paths.push(path);
        }
    }

    fn visit_path(&mut self, path: &'ast syn::Path) {
        if path.segments.len() > 1 {
            self.paths.push(
                path.segments
                    .iter()
                    .map(|segment| segment.ident.to_string())
                    .collect(),
            );
        }
        syn::visit::visit_path(self, path);
    }
}

/// The visible names and full paths of a `use` tree.
fn flatten(tree: &UseTree, prefix: &mut Module, found: &mut Vec<(String, Module)>) {
    let full =
        |prefix: &Module, last: String| prefix.iter().cloned().chain([last]).collect::<Module>();
    match tree {
        UseTree::Path(path) => {
            prefix.push(path.ident.to_string());
            flatten(&path.tree, prefix, found);
            prefix.pop();
        }
        UseTree::Name(name) => {
            found.push((name.ident.to_string(), full(prefix, name.ident.to_string())))
        }
        UseTree::Rename(name) => found.push((
            name.rename.to_string(),
            full(prefix, name.ident.to_string()),
        )),
        UseTree::Glob(_) => found.push(("*".to_owned(), prefix.clone())),
        UseTree::Group(group) => group
            .items
            .iter()
            .for_each(|tree| flatten(tree, prefix, found)),
    }
}

fn parse(text: &str) -> File {
    let mut file = File::default();
    file.visit_file(&syn::parse_file(text).unwrap());
    file
}

/// All files of a crate by module.
fn files_in(root: &Path) -> BTreeMap<Module, File> {
    let mut files = BTreeMap::new();
    let mut folders = vec![root.to_owned()];
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(&folder).unwrap() {
            let path: PathBuf = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
            } else if path.extension().is_some_and(|extension| extension == "rs") {
                let relative = path.strip_prefix(root).unwrap().with_extension("");
                let mut module: Module = relative
                    .iter()
                    .map(|part| part.to_str().unwrap().to_owned())
                    .collect();
                module.pop_if(|last| matches!(last.as_str(), "mod" | "lib" | "main"));
                files.insert(module, parse(&std::fs::read_to_string(&path).unwrap()));
            }
        }
    }
    files
}

/// Converts a path that is used in `module` to a path from the crate root; `None` if it leads to
/// another crate.
fn absolute(
    module: &Module,
    path: &[String],
    is_module: impl Fn(&Module) -> bool,
) -> Option<Module> {
    let mut base = module.clone();
    let mut rest = path;
    match path.first()?.as_str() {
        "crate" => (base, rest) = (Module::new(), &path[1..]),
        "self" => rest = &path[1..],
        "super" => {
            while rest.first().is_some_and(|first| first == "super") {
                base.pop()?;
                rest = &rest[1..];
            }
        }
        first => {
            base.push(first.to_owned());
            if !is_module(&base) {
                return None;
            }
            rest = &path[1..];
        }
    }
    base.extend_from_slice(rest);
    Some(base)
}

/// The file that defines the item at a path; follows re-exports.
fn defining_file(files: &BTreeMap<Module, File>, path: &Module, depth: u32) -> Module {
    let length = (0..=path.len())
        .rev()
        .find(|length| files.contains_key(&path[..*length]))
        .unwrap_or(0);
    let (module, rest) = (path[..length].to_vec(), &path[length..]);
    let Some(target) = rest
        .first()
        .and_then(|name| files.get(&module)?.exports.get(name))
    else {
        return module;
    };
    match absolute(&module, target, |module| files.contains_key(module)) {
        Some(target) if depth < 8 && target != *path => defining_file(files, &target, depth + 1),
        _ => module,
    }
}

fn graph(files: &BTreeMap<Module, File>) -> Graph {
    let tests: Vec<Module> = files
        .iter()
        .flat_map(|(module, file)| {
            file.test_modules
                .iter()
                .map(|name| module.iter().chain([name]).cloned().collect::<Module>())
        })
        .collect();
    let is_test = |module: &Module| tests.iter().any(|test| module.starts_with(test));
    files
        .iter()
        .filter(|(module, _)| !is_test(module))
        .map(|(module, file)| {
            let targets = file.paths.iter().filter_map(|path| {
                let path = absolute(module, path, |module| files.contains_key(module))?;
                let target = defining_file(files, &path, 0);
                (!target.starts_with(module) && !is_test(&target)).then_some(target)
            });
            (module.clone(), targets.collect())
        })
        .collect()
}

/// All imports that are part of a cycle.
fn cycles(graph: &Graph) -> Vec<String> {
    let reachable = |from: &Module| {
        let mut reached = BTreeSet::new();
        let mut pending: Vec<&Module> = graph[from].iter().collect();
        while let Some(module) = pending.pop() {
            if reached.insert(module.clone()) {
                pending.extend(graph.get(module).into_iter().flatten());
            }
        }
        reached
    };
    let reachable: BTreeMap<&Module, BTreeSet<Module>> = graph
        .keys()
        .map(|module| (module, reachable(module)))
        .collect();
    let on_cycle = |a: &Module, b: &Module| {
        reachable[a].contains(b) && reachable.get(b).is_some_and(|from_b| from_b.contains(a))
    };
    let name = |module: &Module| {
        if module.is_empty() {
            "crate root".to_owned()
        } else {
            module.join("::")
        }
    };
    graph
        .iter()
        .flat_map(|(module, targets)| targets.iter().map(move |target| (module, target)))
        .filter(|(module, target)| on_cycle(module, target))
        .map(|(module, target)| format!("{} -> {}", name(module), name(target)))
        .collect()
}

#[test]
fn files_do_not_import_each_other_in_cycles() {
    let workspace = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut found = Vec::new();
    for root in ROOTS {
        let files = files_in(&workspace.join(root));
        let graph = graph(&files);
        assert!(
            graph.len() == 1 || graph.values().any(|targets| !targets.is_empty()),
            "{root}: no imports were found"
        );
        found.extend(
            cycles(&graph)
                .into_iter()
                .map(|edge| format!("{root}: {edge}")),
        );
    }
    assert_eq!(found, Vec::<String>::new());
}

#[test]
fn cycles_are_found_through_re_exports_and_paths() {
    let files = |sources: &[(&str, &str)]| -> BTreeMap<Module, File> {
        let module = |name: &str| {
            name.split("::")
                .filter(|part| !part.is_empty())
                .map(str::to_owned)
                .collect()
        };
        sources
            .iter()
            .map(|(name, text)| (module(name), parse(text)))
            .collect()
    };
    let sources = [
        ("", "mod a; mod b; #[cfg(test)] mod t; pub use b::inner::B;"),
        ("a", "use crate::B; use super::t::T; pub struct A;"),
        ("b", "pub mod inner;"),
        ("b::inner", "pub struct B; fn f() { crate::a::g(); }"),
        ("t", "use crate::a::A;"),
    ];
    assert_eq!(
        cycles(&graph(&files(&sources))),
        ["a -> b::inner", "b::inner -> a"]
    );
    let acyclic = [
        sources[0],
        sources[1],
        sources[2],
        (
            "b::inner",
            "pub struct B; #[cfg(test)] mod x { use crate::a::A; }",
        ),
    ];
    assert_eq!(cycles(&graph(&files(&acyclic))), Vec::<String>::new());
}
