//! Checks that the source files of each crate do not import each other in cycles.
//!
//! The graph is read from the source: `use` items and paths such as `crate::join::Join`, also in
//! arguments of macros and attributes. Every name is followed to the file that defines it, through
//! `use` items and through re-exports of other files. Glob imports are not followed; the lint
//! `wildcard_imports` rejects them. A module may import from its parents, and a parent may
//! re-export its children, so imports of a module's own submodules do not count. Test code does not
//! count either.
#![expect(clippy::unwrap_used, reason = "a test that cannot continue may panic")]

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use syn::buffer::{Cursor, TokenBuffer};
use syn::visit::Visit;
use syn::{Attribute, Item, UseTree};

/// Path of a module within its crate; empty for the crate root.
type Module = Vec<String>;
/// The modules that each module imports from.
type Graph = BTreeMap<Module, BTreeSet<Module>>;

/// Imports of one file.
#[derive(Default)]
struct File {
    /// Paths as written: relative ones start with `self`, `super`, or the name of a submodule.
    paths: Vec<Module>,
    /// Names of `use` items and the paths that they refer to. Private names count, because
    /// submodules can use them, too.
    names: BTreeMap<String, Module>,
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
        let mut found = Vec::new();
        flatten(&item.tree, &mut Vec::new(), &mut found);
        for (name, path) in found {
            self.names.insert(name, path.clone());
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

    fn visit_macro(&mut self, call: &'ast syn::Macro) {
        let tokens = TokenBuffer::new2(call.tokens.clone());
        find_paths(tokens.begin(), &mut self.paths);
        syn::visit::visit_macro(self, call);
    }

    fn visit_meta_list(&mut self, attribute: &'ast syn::MetaList) {
        let tokens = TokenBuffer::new2(attribute.tokens.clone());
        find_paths(tokens.begin(), &mut self.paths);
        syn::visit::visit_meta_list(self, attribute);
    }
}

/// Appends all paths with several segments that occur in tokens. This is for tokens that are not
/// parsed, such as arguments of macros.
fn find_paths(mut tokens: Cursor<'_>, found: &mut Vec<Module>) {
    loop {
        if let Some((path, rest)) = path_at(tokens) {
            if path.len() > 1 {
                found.push(path);
            }
            tokens = rest;
        } else if let Some((inside, _, _, rest)) = tokens.any_group() {
            find_paths(inside, found);
            tokens = rest;
        } else if let Some((_, rest)) = tokens.token_tree() {
            tokens = rest;
        } else {
            return;
        }
    }
}

/// The path at the start of some tokens, and the tokens after it.
fn path_at(tokens: Cursor<'_>) -> Option<(Module, Cursor<'_>)> {
    let (first, mut rest) = tokens.ident()?;
    let mut path = vec![first.to_string()];
    while let Some((segment, after)) = segment_at(rest) {
        path.push(segment);
        rest = after;
    }
    Some((path, rest))
}

/// The segment `::name` at the start of some tokens, and the tokens after it.
fn segment_at(tokens: Cursor<'_>) -> Option<(String, Cursor<'_>)> {
    let (first, rest) = tokens.punct()?;
    let (second, rest) = rest.punct()?;
    let (name, rest) = rest.ident()?;
    let is_segment = first.as_char() == ':' && second.as_char() == ':';
    is_segment.then(|| (name.to_string(), rest))
}

/// The visible names and full paths of a `use` tree.
fn flatten(tree: &UseTree, prefix: &mut Module, found: &mut Vec<(String, Module)>) {
    match tree {
        UseTree::Path(path) => {
            prefix.push(path.ident.to_string());
            flatten(&path.tree, prefix, found);
            prefix.pop();
        }
        UseTree::Name(name) => {
            let path = full_path(prefix, &name.ident);
            found.extend(path.last().cloned().map(|name| (name, path)));
        }
        UseTree::Rename(name) => {
            found.push((name.rename.to_string(), full_path(prefix, &name.ident)));
        }
        UseTree::Glob(_) => found.push(("*".to_owned(), prefix.clone())),
        UseTree::Group(group) => group
            .items
            .iter()
            .for_each(|tree| flatten(tree, prefix, found)),
    }
}

/// The path of a name in a `use` tree. The name `self` is the path before it.
fn full_path(prefix: &Module, name: &syn::Ident) -> Module {
    let mut path = prefix.clone();
    if name != "self" {
        path.push(name.to_string());
    }
    path
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

/// Largest number of `use` items through which a name is followed.
const MAX_DEPTH: u32 = 8;

/// Converts a path that is used in `module` to a path from the crate root; `None` if it leads to
/// another crate.
fn absolute(
    files: &BTreeMap<Module, File>,
    module: &Module,
    path: &[String],
    depth: u32,
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
            rest = &path[1..];
            base.push(first.to_owned());
            if !files.contains_key(&base) {
                let imported = files.get(module)?.names.get(first)?;
                let full: Module = imported.iter().chain(rest).cloned().collect();
                // In `use serde;`, the name of another crate refers to itself.
                let is_resolvable = depth < MAX_DEPTH && imported[0] != first;
                return is_resolvable
                    .then(|| absolute(files, module, &full, depth + 1))
                    .flatten();
            }
        }
    }
    base.extend_from_slice(rest);
    Some(base)
}

/// The file that defines the item at a path; follows `use` items.
fn defining_file(files: &BTreeMap<Module, File>, path: &Module, depth: u32) -> Module {
    let length = (0..=path.len())
        .rev()
        .find(|length| files.contains_key(&path[..*length]))
        .unwrap_or(0);
    let (module, rest) = (path[..length].to_vec(), &path[length..]);
    let Some(target) = rest
        .first()
        .and_then(|name| files.get(&module)?.names.get(name))
    else {
        return module;
    };
    let target: Module = target.iter().chain(&rest[1..]).cloned().collect();
    match absolute(files, &module, &target, depth) {
        Some(target) if depth < MAX_DEPTH && target != *path => {
            defining_file(files, &target, depth + 1)
        }
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
                let path = absolute(files, module, path, 0)?;
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

/// The crates of the workspace, as folders relative to it. The root is `.`.
fn crates() -> Vec<String> {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/Cargo.toml");
    let manifest: toml::Table = std::fs::read_to_string(path).unwrap().parse().unwrap();
    let members = manifest["workspace"]["members"].as_array().unwrap();
    members
        .iter()
        .map(|member| member.as_str().unwrap().to_owned())
        .chain([".".to_owned()])
        .collect()
}

/// All files of a crate of the workspace by module.
fn files_of_crate(folder: &str) -> BTreeMap<Module, File> {
    let workspace = Path::new(env!("CARGO_MANIFEST_DIR"));
    files_in(&workspace.join(folder).join("src"))
}

#[test]
fn files_do_not_import_each_other_in_cycles() {
    let mut found = Vec::new();
    let mut n_files = 0;
    let mut n_imports = 0;
    for folder in crates() {
        let graph = graph(&files_of_crate(&folder));
        assert!(!graph.is_empty(), "{folder}: no files were found");
        n_files += graph.len();
        n_imports += graph.values().map(BTreeSet::len).sum::<usize>();
        found.extend(
            cycles(&graph)
                .into_iter()
                .map(|edge| format!("{folder}: {edge}")),
        );
    }
    assert!(
        n_imports > n_files,
        "only {n_imports} imports were found in {n_files} files"
    );
    assert_eq!(found, Vec::<String>::new());
}

/// Imports of a motor family by code outside its folder. Families have a file `codec.rs`.
fn imports_of_families(graph: &Graph) -> Vec<String> {
    let families: BTreeSet<&[String]> = graph
        .keys()
        .filter(|module| module.len() == 3 && module[0] == "can" && module[2] == "codec")
        .map(|module| &module[..2])
        .collect();
    assert!(!families.is_empty(), "no motor family was found");
    let mut found = Vec::new();
    for (module, targets) in graph {
        for family in &families {
            let imports = targets.iter().any(|target| target.starts_with(family));
            if imports && !module.starts_with(family) {
                found.push(format!("{} -> {}", module.join("::"), family.join("::")));
            }
        }
    }
    found
}

/// The list `FAMILIES` in `drivers/src/can/mod.rs` is an import of a module's own submodules, which
/// does not count.
#[test]
fn code_for_all_motor_families_imports_no_family() {
    let graph = graph(&files_of_crate("drivers"));
    assert_eq!(imports_of_families(&graph), Vec::<String>::new());
}

/// Files of a crate by the path of their module, such as `a::b`.
fn parse_all(sources: &[(&str, &str)]) -> BTreeMap<Module, File> {
    sources
        .iter()
        .map(|(path, text)| (module_at(path), parse(text)))
        .collect()
}

fn module_at(path: &str) -> Module {
    path.split("::")
        .filter(|part| !part.is_empty())
        .map(str::to_owned)
        .collect()
}

#[test]
fn imports_of_a_motor_family_are_found_through_re_exports() {
    let sources = [
        ("", "mod can;"),
        ("can", "mod a; mod plan; pub use a::Ids;"),
        ("can::a", "mod codec; mod ids; pub use ids::Ids;"),
        ("can::a::codec", "use super::Ids;"),
        ("can::a::ids", "pub struct Ids;"),
        ("can::plan", "use super::Ids;"),
    ];
    assert_eq!(
        imports_of_families(&graph(&parse_all(&sources))),
        ["can::plan -> can::a"]
    );
}

#[test]
fn cycles_are_found_through_re_exports_and_paths() {
    let sources = [
        ("", "mod a; mod b; #[cfg(test)] mod t; pub use b::inner::B;"),
        ("a", "use crate::B; use super::t::T; pub struct A;"),
        ("b", "pub mod inner;"),
        ("b::inner", "pub struct B; fn f() { crate::a::g(); }"),
        ("t", "use crate::a::A;"),
    ];
    assert_eq!(
        cycles(&graph(&parse_all(&sources))),
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
    assert_eq!(cycles(&graph(&parse_all(&acyclic))), Vec::<String>::new());
}

#[test]
fn cycles_are_found_through_imported_modules_and_macros() {
    let root = ("", "mod a; mod b;");
    let b = ("b", "mod inner; pub use inner::B;");
    let inner = ("b::inner", "use crate::a::A; pub struct B;");
    for a in [
        "use super::b; pub struct A(b::B);",
        "use super::b::{self}; pub struct A(b::B);",
        "pub struct A; fn f() { log::warn!(\"{:?}\", (crate::b::B)); }",
        "#[error(\"{}\", crate::b::B)] pub struct A;",
    ] {
        assert_eq!(
            cycles(&graph(&parse_all(&[root, ("a", a), b, inner]))),
            ["a -> b::inner", "b::inner -> a"],
            "{a}"
        );
    }
}
