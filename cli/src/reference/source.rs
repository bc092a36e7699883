//! Structs and enums of configurations from their source files: names, types, descriptions and earlier names.

use std::collections::BTreeMap;
use std::path::Path;

use super::root;

/// A serialised struct or enum.
#[derive(Debug, Default)]
pub struct Item {
    pub name: String,
    attributes: Vec<String>,
    /// Fields of a struct.
    pub fields: Vec<Field>,
    /// Variants of an enum.
    pub variants: Vec<Field>,
}

/// A field of a struct, or a variant of an enum.
#[derive(Debug, Default, Clone)]
pub struct Field {
    /// Name in files.
    pub name: String,
    /// Type of a field, or of a variant's value; empty for a variant without a value.
    pub ty: String,
    /// Doc comment.
    pub doc: String,
    /// Earlier names that files may use.
    pub aliases: Vec<String>,
    /// True if files may omit it.
    pub optional: bool,
    /// Fields of a variant.
    pub fields: Vec<Field>,
}

/// The items of the sources, and the configuration of each `kind`.
pub struct Sources {
    items: BTreeMap<String, Item>,
    /// For each `kind` in files: the family, such as `Fields`, and the struct.
    pub kinds: Vec<(String, String, String)>,
}

/// The text between two markers.
fn between<'a>(text: &'a str, before: &str, after: &str) -> Option<&'a str> {
    Some(text.split_once(before)?.1.split_once(after)?.0)
}

/// The name of a variant under a rename rule.
fn renamed(variant: &str, rule: Option<&str>) -> String {
    match rule {
        None => variant.to_owned(),
        Some("lowercase") => variant.to_lowercase(),
        Some("kebab-case") => {
            let dash = |(i, c): (usize, char)| if i > 0 && c.is_uppercase() { vec!['-', c] } else { vec![c] };
            variant.char_indices().flat_map(dash).collect::<String>().to_lowercase()
        }
        Some(other) => panic!("an unknown rule `{other}`"),
    }
}

impl Item {
    fn attribute(&self, before: &str) -> Option<&str> {
        self.attributes.iter().find_map(|attribute| between(attribute, before, "\""))
    }

    /// Returns true if files may omit fields.
    fn has_default(&self) -> bool {
        self.attributes.iter().any(|a| a.contains("serde(") && a.trim_end_matches(")]").ends_with("default"))
    }
}

impl Sources {
    /// Parses the files that define configurations.
    pub fn read() -> Self {
        let mut sources = Sources { items: BTreeMap::new(), kinds: vec![] };
        for folder in ["nerf/src", "autograd/nn/src", "cli/src"] {
            sources.folder(&root().join(folder));
        }
        sources
    }

    fn folder(&mut self, folder: &Path) {
        let mut paths: Vec<_> = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect();
        paths.sort();
        for path in paths {
            if path.is_dir() {
                self.folder(&path);
            } else if path.extension().is_some_and(|extension| extension == "rs") {
                self.file(&std::fs::read_to_string(&path).unwrap());
            }
        }
    }

    /// The struct or enum of this name.
    pub fn get(&self, name: &str) -> Option<&Item> {
        self.items.get(name)
    }

    fn file(&mut self, text: &str) {
        self.find_kinds(text);
        let (mut written, mut read) = (vec![], vec![]);
        for item in parse(text) {
            let derives = |word: &str| item.attributes.iter().any(|a| a.starts_with("#[derive(") && a.contains(word));
            if derives("Serialize,") || derives(" Serialize") {
                written.push(item);
            } else if derives("Deserialize") {
                read.push(item);
            }
        }
        for mut item in written {
            // A second struct or enum defines other forms in files.
            if let Some(name) = item.attribute("from = \"") {
                let stored = read.iter().find(|item| item.name == name).expect("the struct that is read");
                item.absorb(stored);
            }
            if item.name == "Config" || !self.items.contains_key(&item.name) {
                self.items.insert(item.name.clone(), item);
            }
        }
    }

    fn find_kinds(&mut self, text: &str) {
        for (start, _) in text.match_indices("\nimpl ComponentConfig<") {
            let block = &text[start..];
            let (family, config) = (between(block, "<", ">"), between(block, " for ", " {"));
            if let (Some(family), Some(config), Some(kind)) =
                (family, config, between(block, "const KIND: &'static str = \"", "\""))
            {
                self.kinds.push((kind.to_owned(), family.to_owned(), config.to_owned()));
            }
        }
        if let Some(terms) = between(text, "\nterms!(", ");") {
            for term in terms.split(", ") {
                let (kind, config) = term.split_once("\" ").unwrap();
                self.kinds.push((kind.trim_matches('"').to_owned(), "LossTerms".to_owned(), config.to_owned()));
            }
        }
    }
}

impl Item {
    /// Adds the earlier names of the struct or enum that deserialisation uses.
    fn absorb(&mut self, stored: &Item) {
        let fields = stored.fields.iter().chain(stored.variants.iter().flat_map(|variant| &variant.fields));
        for field in fields {
            match self.fields.iter_mut().find(|own| own.name == field.name) {
                Some(own) => {
                    own.aliases.extend(field.aliases.clone());
                    own.optional |= stored.has_default();
                }
                // A key of earlier versions only.
                None => self.variants.push(Field { ty: "earlier".into(), ..field.clone() }),
            }
        }
        let names = stored.variants.iter().filter(|variant| !variant.ty.is_empty() && variant.fields.is_empty());
        self.variants.extend(names.map(|variant| Field { ty: variant.ty.clone(), ..Field::default() }));
    }
}

/// Parses the structs and enums of a file, which rustfmt has formatted.
fn parse(text: &str) -> Vec<Item> {
    let (mut items, mut attributes) = (vec![], vec![]);
    let mut lines = text.lines().peekable();
    while let Some(line) = lines.next() {
        let declared = line.strip_prefix("pub ").unwrap_or(line);
        let name = ["struct ", "enum "].iter().find_map(|word| declared.strip_prefix(word)?.strip_suffix(" {"));
        if line.starts_with("#[") {
            attributes.push(line.to_owned());
        } else if let Some(name) = name {
            let mut body = vec![];
            for line in lines.by_ref().take_while(|line| *line != "}") {
                body.push(line.trim());
            }
            let mut item =
                Item { name: name.to_owned(), attributes: std::mem::take(&mut attributes), ..Item::default() };
            let parsed = members(&mut body.into_iter(), item.attribute("rename_all = \""), item.has_default());
            *(if declared.starts_with("enum") { &mut item.variants } else { &mut item.fields }) = parsed;
            items.push(item);
        } else if !line.starts_with("///") {
            attributes.clear();
        }
    }
    items
}

/// Parses fields or variants up to a closing brace.
fn members<'a>(lines: &mut impl Iterator<Item = &'a str>, rule: Option<&str>, optional: bool) -> Vec<Field> {
    let (mut all, mut doc, mut attributes) = (vec![], vec![], String::new());
    while let Some(line) = lines.next() {
        if line.starts_with('}') {
            break;
        }
        if let Some(text) = line.strip_prefix("///") {
            doc.push(text.trim());
            continue;
        }
        if line.starts_with("#[") {
            attributes += line;
            continue;
        }
        if line.is_empty() || line.starts_with("//") {
            continue;
        }
        let aliases = attributes.split("alias = \"").skip(1).map(|rest| rest.split('"').next().unwrap().to_owned());
        let mut field = Field {
            doc: doc.join(" "),
            aliases: aliases.collect(),
            optional: optional || attributes.contains("serde(default"),
            ..Field::default()
        };
        let line = line.trim_start_matches("pub(crate) ").trim_start_matches("pub ").trim_end_matches(',');
        if let Some(variant) = line.strip_suffix(" {") {
            field.name = renamed(variant, rule);
            field.fields = members(lines, None, false);
        } else if let Some((name, ty)) = line.split_once(": ") {
            (field.name, field.ty) = (name.to_owned(), ty.to_owned());
            field.optional |= ty.starts_with("Option<");
        } else if let Some((variant, ty)) = line.split_once('(') {
            (field.name, field.ty) = (renamed(variant, rule), ty.trim_end_matches(')').to_owned());
        } else {
            field.name = renamed(line, rule);
        }
        if let Some(name) = between(&attributes, "rename = \"", "\"") {
            field.name = name.to_owned();
        }
        all.push(field);
        (doc, attributes) = (vec![], String::new());
    }
    all
}

#[test]
fn parse_structs_and_enums_gives_members() {
    let text = "/// A.\n#[derive(Debug, Serialize, Deserialize)]\n#[serde(deny_unknown_fields, default)]\npub struct A {\n    \
                /// One,\n    /// two.\n    #[serde(alias = \"old\")]\n    pub new: Vec<usize>,\n}\n\n#[derive(Serialize)]\n\
                #[serde(rename_all = \"kebab-case\")]\nenum B {\n    /// Plain.\n    OneTwo,\n    /// Fields.\n    Three {\n        \
                /// X.\n        x: f64,\n    },\n    /// Value.\n    #[serde(rename = \"four\")]\n    Four(u64),\n}\n";
    let items = parse(text);
    let [a, b] = &items[..] else { panic!("{items:?}") };
    let field = &a.fields[0];
    assert_eq!((field.name.as_str(), field.ty.as_str(), field.doc.as_str()), ("new", "Vec<usize>", "One, two."));
    assert!(field.optional && field.aliases == ["old"]);
    let names: Vec<&str> = b.variants.iter().map(|variant| variant.name.as_str()).collect();
    assert_eq!(names, ["one-two", "three", "four"]);
    assert_eq!((b.variants[1].fields[0].name.as_str(), b.variants[2].ty.as_str()), ("x", "u64"));
    assert!(!b.variants[1].fields[0].optional && renamed("Gauss2", Some("kebab-case")) == "gauss2");
}
