//! Elements and attributes of a robot description, and notes about unused elements and attributes.

use crate::Error;
use crate::xml_limits::{self, MAX_NAMESPACES, MAX_NODES};
use roxmltree::{Document, Node, ParsingOptions};
use std::borrow::Cow;
use std::collections::{BTreeMap, BTreeSet};

/// Maximum size of a robot description. It is far above the size of any real description, because
/// meshes are in other files. It prevents a wrong file from filling the memory.
pub const MAX_BYTES: usize = 16 << 20;
/// Maximum number of notes. Notes are printed, and a longer list would hide the first notes. The
/// problems in the first notes often cause the others.
const MAX_NOTES: usize = 100;

/// Repairs two mistakes that the parsers of other programs accept: white space before the XML
/// declaration, and prefixes without a namespace. Line numbers do not change.
pub(super) fn repaired(xml: &str) -> Cow<'_, str> {
    let mut text = Cow::Borrowed(xml);
    // An XML declaration that does not start the file is an error in XML 1.0. The contents of the
    // declaration, such as the encoding, do not matter, because the text has already been decoded.
    let begin = xml.len() - xml.trim_start().len();
    if begin > 0
        && xml[begin..].starts_with("<?xml")
        && let Some(n) = xml[begin..].find("?>")
    {
        text.to_mut().replace_range(begin..begin + n + 2, "");
    }
    // Parsers that ignore namespaces accept prefixes without a declaration. `xacro` is left
    // undeclared, because its elements mean that the file has not been expanded.
    let unbound: String = prefixes(xml)
        .into_iter()
        .filter(|prefix| {
            !["xml", "xmlns", "xacro"].contains(prefix) && !xml.contains(&format!("xmlns:{prefix}"))
        })
        .map(|prefix| format!(" xmlns:{prefix}=\"{prefix}\""))
        .collect();
    if !unbound.is_empty()
        && let Some(at) = text.find("<robot")
    {
        text.to_mut().insert_str(at + "<robot".len(), &unbound);
    }
    text
}

/// The prefixes of elements and attributes. Their number is limited. Words in the values of
/// attributes may be returned as well.
fn prefixes(xml: &str) -> BTreeSet<&str> {
    let mut found = BTreeSet::new();
    for tag in xml.split('<').skip(1) {
        let tag = tag.split('>').next().unwrap_or_default();
        // The first word is the name of the element, and the other words are its attributes. White
        // space in values yields words that look like attributes. These words only add declarations
        // that nothing uses.
        let names = tag
            .split_whitespace()
            .enumerate()
            .filter_map(|(ix, word)| match ix {
                0 => Some(word.trim_start_matches('/')),
                _ => word.split_once('=').map(|(name, _)| name),
            });
        found.extend(
            names
                .filter_map(|name| Some(name.split_once(':')?.0))
                .filter(|prefix| is_plain_name(prefix)),
        );
        // `parse` refuses more declarations than this anyway.
        if found.len() > MAX_NAMESPACES {
            break;
        }
    }
    found
}

/// Whether text can be declared as a prefix, that is, whether it is a name of ASCII characters.
/// Other text before a colon may be anything, such as a part of a path. Declaring it could make the
/// file invalid.
fn is_plain_name(text: &str) -> bool {
    text.starts_with(|first: char| first.is_ascii_alphabetic() || first == '_')
        && text
            .chars()
            .all(|c| c.is_ascii_alphanumeric() || c == '_' || c == '-')
}

/// Parses XML whose size and structure are limited.
pub(super) fn parse(xml: &str) -> Result<Document<'_>, Error> {
    xml_limits::check(xml, MAX_BYTES).map_err(|why| Error::UrdfSyntax { why })?;
    let options = ParsingOptions {
        nodes_limit: MAX_NODES,
        ..ParsingOptions::default()
    };
    let document = Document::parse_with_options(xml, options).map_err(|error| {
        let hint = match &error {
            roxmltree::Error::UnknownNamespace(prefix, _) if prefix == "xacro" => {
                "; expand the file with xacro first"
            }
            roxmltree::Error::DtdDetected => "; remove the <!DOCTYPE>",
            _ => "",
        };
        Error::UrdfSyntax {
            why: format!("{error}{hint}"),
        }
    })?;
    match document.root_element().tag_name().name() {
        "robot" => Ok(document),
        other => Err(Error::UrdfSyntax {
            why: format!("it describes a <{other}>, expected a <robot>"),
        }),
    }
}

/// The reason why an element cannot be used.
#[derive(Debug)]
pub(crate) struct Problem {
    pub(crate) line: u32,
    pub(crate) why: String,
}

/// Notes about elements that are not used. Problems come first, in file order. Unknown names
/// follow, in alphabetical order.
#[derive(Debug, Default)]
pub(crate) struct Notes {
    texts: Vec<String>,
    n_omitted: usize,
    /// For each pair of an element name and an unknown name inside such elements: the first line,
    /// and the number of occurrences.
    unknown: BTreeMap<(String, String), (u32, usize)>,
}

impl Notes {
    pub(crate) fn add(&mut self, line: u32, text: &str) {
        if self.texts.len() < MAX_NOTES {
            self.texts.push(format!("line {line}: {text}"));
        } else {
            self.n_omitted += 1;
        }
    }

    pub(crate) fn into_texts(self) -> Vec<String> {
        let Self {
            mut texts,
            n_omitted,
            unknown,
        } = self;
        if n_omitted > 0 {
            texts.push(format!("{n_omitted} more notes are not shown"));
        }
        let n_kinds = unknown.len();
        for ((parent, what), (line, n)) in unknown.into_iter().take(MAX_NOTES) {
            let others = if n > 1 {
                format!(" (and {} more)", n - 1)
            } else {
                String::new()
            };
            texts.push(format!(
                "line {line}{others}: {what} in <{parent}> is not used"
            ));
        }
        if n_kinds > MAX_NOTES {
            texts.push(format!(
                "{} more unknown names are not used",
                n_kinds - MAX_NOTES
            ));
        }
        texts
    }
}

/// An element with its attributes and children.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Element<'a>(Node<'a, 'a>);

impl<'a> Element<'a> {
    pub(super) fn root(document: &'a Document<'a>) -> Self {
        Self(document.root_element())
    }

    /// Line in the file, from 1.
    pub(crate) fn line(self) -> u32 {
        self.0.document().text_pos_at(self.0.range().start).row
    }

    pub(crate) fn tag(self) -> &'a str {
        self.0.tag_name().name()
    }

    pub(crate) fn problem(self, why: impl Into<String>) -> Problem {
        Problem {
            line: self.line(),
            why: why.into(),
        }
    }

    /// The children with this tag.
    pub(crate) fn all(self, tag: &'static str) -> impl Iterator<Item = Element<'a>> {
        self.children().filter(move |child| child.tag() == tag)
    }

    pub(crate) fn children(self) -> impl Iterator<Item = Element<'a>> {
        let namespace = self.0.document().root_element().tag_name().namespace();
        // An element of another namespace, such as the namespace of xacro, has a different meaning.
        self.0
            .children()
            .filter(move |node| node.is_element() && node.tag_name().namespace() == namespace)
            .map(Self)
    }

    /// The only child with this tag. Repetitions are accepted if they have the same attributes.
    pub(crate) fn only(self, tag: &'static str) -> Result<Option<Self>, Problem> {
        let mut all = self.all(tag);
        let Some(first) = all.next() else {
            return Ok(None);
        };
        // Positions in the file differ between copies, so only names and values are compared.
        let attributes =
            |element: Element<'a>| element.0.attributes().map(|a| (a.name(), a.value()));
        match all.find(|other| !attributes(first).eq(attributes(*other))) {
            None => Ok(Some(first)),
            Some(other) => {
                let why = format!(
                    "it has two different elements <{tag}>, in lines {} and {}",
                    first.line(),
                    other.line()
                );
                Err(self.problem(why))
            }
        }
    }

    /// The only child with this tag, which must exist.
    pub(crate) fn required_child(self, tag: &'static str) -> Result<Self, Problem> {
        self.only(tag)?
            .ok_or_else(|| self.problem(format!("it has no <{tag}>")))
    }

    pub(crate) fn attribute(self, name: &str) -> Option<&'a str> {
        self.0.attribute(name)
    }

    pub(crate) fn required(self, name: &str) -> Result<&'a str, Problem> {
        self.attribute(name)
            .ok_or_else(|| self.problem(format!("<{}> has no attribute {name:?}", self.tag())))
    }

    /// The numbers in an attribute.
    pub(crate) fn numbers<const N: usize>(self, name: &str) -> Result<Option<[f64; N]>, Problem> {
        let Some(text) = self.attribute(name) else {
            return Ok(None);
        };
        let numbers: Option<Vec<f64>> = text
            .split_whitespace()
            .map(|word| word.parse().ok())
            .collect();
        let numbers = numbers.and_then(|numbers| <[f64; N]>::try_from(numbers).ok());
        if let Some(numbers) =
            // `parse` of f64 accepts "nan" and "inf".
            numbers.filter(|numbers| numbers.iter().all(|number| number.is_finite()))
        {
            return Ok(Some(numbers));
        }
        let expected = match N {
            1 => "a number".to_owned(),
            _ => format!("{N} numbers with spaces between them"),
        };
        let xacro = if text.contains("${") {
            " (expand the file with xacro first)"
        } else {
            ""
        };
        // The text may be a whole file by mistake.
        let shown: String = text.chars().take(60).collect();
        Err(self.problem(format!(
            "{name} of <{}> is {shown:?}, expected {expected}{xacro}",
            self.tag()
        )))
    }

    pub(crate) fn number(self, name: &str) -> Result<Option<f64>, Problem> {
        Ok(self.numbers::<1>(name)?.map(|[number]| number))
    }

    /// Notes each attribute and child that is not listed.
    pub(crate) fn note_unknown(self, attributes: &[&str], children: &[&str], notes: &mut Notes) {
        for attribute in self.0.attributes() {
            if attribute.namespace().is_none() && !attributes.contains(&attribute.name()) {
                let what = format!("the attribute {:?}", attribute.name());
                self.add_unknown(what, attribute.range().start, notes);
            }
        }
        for child in self.0.children().filter(Node::is_element) {
            let tag = child.tag_name();
            if tag.namespace() == self.0.document().root_element().tag_name().namespace() {
                if !children.contains(&tag.name()) {
                    let what = format!("<{}>", tag.name());
                    self.add_unknown(what, child.range().start, notes);
                }
            } else if tag
                .namespace()
                .is_some_and(|namespace| namespace.contains("xacro"))
            {
                let what = format!("<xacro:{}>, which xacro has not expanded,", tag.name());
                self.add_unknown(what, child.range().start, notes);
            }
        }
    }

    /// Counts an unknown name at a position of the text.
    fn add_unknown(self, what: String, at: usize, notes: &mut Notes) {
        // The time to find a line grows with the size of the file, so the line is found only for
        // the first occurrence.
        let first = || (self.0.document().text_pos_at(at).row, 1);
        notes
            .unknown
            .entry((self.tag().to_owned(), what))
            .and_modify(|(_, n)| *n += 1)
            .or_insert_with(first);
    }
}
