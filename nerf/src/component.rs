//! Custom fields, samplers and loss terms: implement [`ComponentConfig`] for a configuration, then [`register`] its
//! name.
//!
//! A [`Config`](crate::Config) holds each as an [`AnyConfig`], which reads and writes `{"kind": "<KIND>", ..}`.

use crate::space::cube::Space;
use crate::{Error, Result};
use rand::Rng;
use raygrad_autograd::Scalar;
use raygrad_nn::Params;
use serde::de::{DeserializeOwned, Error as _};
use serde::ser::SerializeMap;
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use serde_json::Value;
use std::any::Any;
use std::fmt;
use std::sync::{PoisonError, RwLock};

/// A type of component that a configuration chooses by name: [`Fields`](crate::Fields), [`Samplers`](crate::Samplers)
/// or [`LossTerms`](crate::LossTerms).
pub trait ComponentType: Sized + 'static {
    /// The name of the component type in messages, such as `field`.
    const WHAT: &'static str;
    /// The type that a configuration builds.
    type Built<T: Scalar>: 'static;
}

/// The arguments of [`ComponentConfig::build`].
pub struct BuildContext<'a, T: Scalar> {
    /// The map from the scene to the unit cube.
    pub space: Space,
    /// Number of training images, for components with parameters per image; 0 if it is not known.
    pub frames: usize,
    /// The parameters, to which the component adds its own.
    pub params: &'a mut Params<T>,
    /// The prefix of the parameters' names: `<name>.table`.
    pub name: &'a str,
    /// The source of initial values.
    pub rng: &'a mut dyn Rng,
}

impl<T: Scalar> BuildContext<'_, T> {
    /// Returns a context for a part of this component, with the prefix `name`.
    pub fn child<'b>(&'b mut self, name: &'b str) -> BuildContext<'b, T> {
        BuildContext { space: self.space, frames: self.frames, params: &mut *self.params, name, rng: &mut *self.rng }
    }
}

/// A named configuration of a field (`ComponentConfig<Fields>`), a sampler (`ComponentConfig<Samplers>`) or a loss term
/// (`ComponentConfig<LossTerms>`).
///
/// In a file it is `{"kind": "<KIND>", ..}` with the configuration's own fields. [`register`] the name before reading
/// such a file.
pub trait ComponentConfig<F: ComponentType>:
    Serialize + DeserializeOwned + Clone + fmt::Debug + Send + Sync + 'static
{
    /// The name in files.
    const KIND: &'static str;

    /// Checks that all values are in range.
    ///
    /// # Errors
    /// If a value is out of range.
    fn check(&self) -> Result<()> {
        Ok(())
    }

    /// Builds the component and adds its parameters to `site.params`.
    ///
    /// # Errors
    /// If these values cannot be built.
    fn build<T: Scalar>(&self, site: BuildContext<'_, T>) -> Result<F::Built<T>>;
}

/// A type-erased [`ComponentConfig`], as a [`Config`](crate::Config) holds it.
pub struct AnyConfig<F: ComponentType>(Box<dyn AnyKind<F>>);

impl<F: ComponentType> AnyConfig<F> {
    /// Erases the type of `config`.
    pub fn new(config: impl ComponentConfig<F>) -> Self {
        AnyConfig(Box::new(config))
    }

    /// Returns its [`ComponentConfig::KIND`].
    pub fn kind(&self) -> &'static str {
        self.0.kind()
    }

    /// Returns the configuration if it is a `K`.
    pub fn get<K: ComponentConfig<F>>(&self) -> Option<&K> {
        (&*self.0 as &dyn Any).downcast_ref()
    }

    /// Returns the configuration mutably if it is a `K`.
    pub fn get_mut<K: ComponentConfig<F>>(&mut self) -> Option<&mut K> {
        (&mut *self.0 as &mut dyn Any).downcast_mut()
    }

    /// Checks that all values are in range.
    ///
    /// # Errors
    /// As [`ComponentConfig::check`].
    pub fn check(&self) -> Result<()> {
        self.0.check()
    }

    /// Checks the configuration, builds the component and adds its parameters to `site.params`.
    ///
    /// # Errors
    /// As [`ComponentConfig::check`] and [`ComponentConfig::build`]; also if `T` is neither f32 nor f64.
    pub fn build<T: Scalar>(&self, site: BuildContext<'_, T>) -> Result<F::Built<T>> {
        self.check()?;
        let BuildContext { space, frames, params, name, rng } = site;
        let params: &mut dyn Any = params;
        let built: Box<dyn Any> = if let Some(params) = params.downcast_mut() {
            Box::new(self.0.single(BuildContext { space, frames, params, name, rng })?)
        } else if let Some(params) = params.downcast_mut() {
            Box::new(self.0.double(BuildContext { space, frames, params, name, rng })?)
        } else {
            return Err(Error::setting(F::WHAT, "has parameters of another type; use f32 or f64"));
        };
        match built.downcast() {
            Ok(built) => Ok(*built),
            Err(_) => unreachable!("a component has the scalar type of its parameters"),
        }
    }
}

/// [`ComponentConfig`] as an object-safe trait.
trait AnyKind<F: ComponentType>: Any + fmt::Debug + Send + Sync {
    fn kind(&self) -> &'static str;
    fn check(&self) -> Result<()>;
    fn value(&self) -> serde_json::Result<Value>;
    fn boxed(&self) -> Box<dyn AnyKind<F>>;
    fn single(&self, site: BuildContext<'_, f32>) -> Result<F::Built<f32>>;
    fn double(&self, site: BuildContext<'_, f64>) -> Result<F::Built<f64>>;
}

impl<F: ComponentType, K: ComponentConfig<F>> AnyKind<F> for K {
    fn kind(&self) -> &'static str {
        K::KIND
    }

    fn check(&self) -> Result<()> {
        ComponentConfig::check(self)
    }

    fn value(&self) -> serde_json::Result<Value> {
        serde_json::to_value(self)
    }

    fn boxed(&self) -> Box<dyn AnyKind<F>> {
        Box::new(self.clone())
    }

    fn single(&self, site: BuildContext<'_, f32>) -> Result<F::Built<f32>> {
        self.build(site)
    }

    fn double(&self, site: BuildContext<'_, f64>) -> Result<F::Built<f64>> {
        self.build(site)
    }
}

impl<F: ComponentType> Clone for AnyConfig<F> {
    fn clone(&self) -> Self {
        AnyConfig(self.0.boxed())
    }
}

impl<F: ComponentType> fmt::Debug for AnyConfig<F> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

impl<F: ComponentType> PartialEq for AnyConfig<F> {
    /// Compares names and serialised values.
    fn eq(&self, other: &Self) -> bool {
        self.kind() == other.kind() && matches!((self.0.value(), other.0.value()), (Ok(a), Ok(b)) if a == b)
    }
}

/// The key of the name in files.
const KIND: &str = "kind";

impl<F: ComponentType> Serialize for AnyConfig<F> {
    fn serialize<S: Serializer>(&self, serializer: S) -> std::result::Result<S::Ok, S::Error> {
        use serde::ser::Error;
        let Value::Object(fields) = self.0.value().map_err(S::Error::custom)? else {
            return Err(S::Error::custom(format!(
                "the configuration `{}` must be a struct with named fields",
                self.kind()
            )));
        };
        let mut map = serializer.serialize_map(Some(1 + fields.len()))?;
        map.serialize_entry(KIND, self.kind())?;
        fields.iter().try_for_each(|(name, value)| map.serialize_entry(name, value))?;
        map.end()
    }
}

impl<'de, F: ComponentType> Deserialize<'de> for AnyConfig<F> {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> std::result::Result<Self, D::Error> {
        let mut fields = serde_json::Map::deserialize(deserializer)?;
        let named = fields.remove(KIND);
        let Some(kind) = named.as_ref().and_then(Value::as_str) else {
            return Err(D::Error::custom(format!("a {} needs the field `{KIND}` with its name", F::WHAT)));
        };
        // Copied to release the lock: the configuration may contain further components, whose reading locks it again.
        let all: Vec<Registered<F>> = {
            let registered = REGISTERED.read().unwrap_or_else(PoisonError::into_inner);
            registered.iter().filter_map(|one| one.downcast_ref()).copied().collect()
        };
        let Some((_, read)) = all.iter().find(|(known, _)| *known == kind) else {
            let known: Vec<_> = all.iter().map(|(known, _)| *known).collect();
            let remedy = match known.join(", ") {
                names if names.is_empty() => "read it as part of a whole `Config`, or `register` it first".to_owned(),
                names => format!("use {names}; a library user registers others with `register`"),
            };
            return Err(D::Error::custom(format!("unknown {} `{kind}`; {remedy}", F::WHAT)));
        };
        read(Value::Object(fields)).map_err(|error| D::Error::custom(format!("{} `{kind}`: {error}", F::WHAT)))
    }
}

/// A component's name with the function that reads its configuration.
type Registered<F> = (&'static str, fn(Value) -> serde_json::Result<AnyConfig<F>>);

/// All [registered](register) components: a [`Registered`] each, of all types.
static REGISTERED: RwLock<Vec<Box<dyn Any + Send + Sync>>> = RwLock::new(vec![]);

/// Registers the name of a [`ComponentConfig`], so that this program can read it from files.
///
/// Call `register::<Fields, MyFieldConfig>()` once, before the first such file is read. The names of this crate's own
/// components are known already and keep their meaning. Configurations made in code need no registration.
pub fn register<F: ComponentType, K: ComponentConfig<F>>() {
    let one: Registered<F> = (K::KIND, |fields| Ok(AnyConfig::new(serde_json::from_value::<K>(fields)?)));
    REGISTERED.write().unwrap_or_else(PoisonError::into_inner).push(Box::new(one));
}
